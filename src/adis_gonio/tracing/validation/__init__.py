"""Whether what was chosen holds on dwells that took no part."""
