"""Reports of a run: summary, tables, pages, figures."""
