"""Many sessions: fitted and traced by many processes or machines, kept in one store, and summarised."""
