"""Goals over `dds://` through a network that loses, delays, repeats and reorders."""
