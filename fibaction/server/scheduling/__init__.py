"""The order in which accepted goals run, wait and give way."""
