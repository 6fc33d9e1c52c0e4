"""Reports of a run: summary, tables, HTML page and figures."""
