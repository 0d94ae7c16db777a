"""The parts of ``sampler=optimise``: conditions, the search by Optuna, and what came of it."""
