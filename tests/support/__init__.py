"""What several test files share: statistics, runs of both renderers, and calls by value."""
