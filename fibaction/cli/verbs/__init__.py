"""The verbs of the command `fibaction`, one module for each."""
