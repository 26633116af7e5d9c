"""What may be added to the base model: effects of the catalogue, and functions without a name."""
