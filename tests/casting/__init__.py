"""A ray caster that shares nothing with the simulator: physics that the estimator's noise model is not made of."""
