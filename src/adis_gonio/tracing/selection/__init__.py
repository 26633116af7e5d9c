"""Which terms are chosen: the linear problem, the search over models, their posterior, the refits."""
