"""What is published: `make test-wheel` builds it, and says where it is."""
