"""The verbs of the command `fibaction`, a module for each or for some that belong together."""
