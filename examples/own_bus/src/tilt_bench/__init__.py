"""A bench of one's own."""
