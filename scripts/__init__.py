"""The covis command."""
