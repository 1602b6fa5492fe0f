"""A ray caster that shares nothing with the simulator: scans by physics, not by the estimator's noise model."""
