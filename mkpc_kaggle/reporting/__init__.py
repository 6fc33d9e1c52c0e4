"""What a run did: summary, tables, pages, figures."""
