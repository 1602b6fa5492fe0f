"""Is a pose that is called ok right? Groups of simulated and cast scans, estimated and judged against their truth."""
