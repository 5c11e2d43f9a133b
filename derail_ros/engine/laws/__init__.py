"""Force laws, one file each: small functions of states and parameters."""
