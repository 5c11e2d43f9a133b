"""What stands behind the commands of ``derail``: one module a command, imported when it runs."""
