"""The sealed challenge: blind sessions, runners, an oracle and scores (see README.md)."""
