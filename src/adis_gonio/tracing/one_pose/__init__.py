"""One pose as a time series."""
