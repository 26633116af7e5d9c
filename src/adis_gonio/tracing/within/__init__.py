"""Search for effects in the samples inside the dwells."""
