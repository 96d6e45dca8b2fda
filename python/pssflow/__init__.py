"""pssflow."""
