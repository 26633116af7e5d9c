"""What the samples inside the dwells show."""
