"""The transports that come with fibaction, one module or package each, found by URL."""
