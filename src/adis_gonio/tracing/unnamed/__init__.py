"""What stands for a cause without a name, and what an unexplained residual depends on."""
