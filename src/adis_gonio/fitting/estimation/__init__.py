"""From dwells to a fitted model: readings and their noise, terms, and `Fit`. No files, no devices."""
