"""Building blocks of an HTML page: sections, tables, figures in SVG."""
