"""Text tables of samples as people have them: lines, dialect, header, keys, and the table in numbers."""
