"""Discovery: which participants are there, which endpoints they have, and which of them match."""
