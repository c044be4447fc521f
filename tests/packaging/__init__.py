"""What is published: `make test-wheel` builds it, and then runs these tests."""
