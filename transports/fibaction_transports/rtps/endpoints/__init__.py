"""Writers and readers of topics: histories, acknowledgements, repairs and fragments."""
