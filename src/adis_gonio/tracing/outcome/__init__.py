"""What is said: names that stand, findings, errors, figures."""
