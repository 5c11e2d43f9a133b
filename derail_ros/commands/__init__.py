"""The commands of ``derail``, as functions whose parameters are the options."""
