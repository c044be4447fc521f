"""The transports that come with fibaction, one module each; `fibaction` finds them by URL."""
