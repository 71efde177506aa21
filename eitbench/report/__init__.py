"""Floor 7: tables, charts and pages made from records."""
