"""What to measure next: measurements by expected information, and words for them."""
