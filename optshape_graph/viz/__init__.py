"""Pictures: one function for each, which returns its matplotlib figure. No other layer imports plotting libraries."""
