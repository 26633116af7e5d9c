"""Search for effects in the single samples inside the dwells."""
