"""Sessions with disturbances that were invented without a look at the catalogue or at the engine."""
