"""What a run tells: summary, tables, pages, figures."""
