"""The client of an action: goals that are sent, followed, tried again and canceled."""
