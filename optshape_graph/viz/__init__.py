"""Pictures: one function for each, which returns a matplotlib figure. No other layer imports plotting libraries."""
