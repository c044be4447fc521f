"""The two sides of `fibaction bridge`, and the names of actions between them."""
