"""A ray caster that shares nothing with the simulator: scans by physics that the estimator's noise model is not made of."""
