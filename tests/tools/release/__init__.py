"""The steps of a release that a program can take: `make release VERSION=0.1.0`."""
