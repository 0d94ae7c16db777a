"""The race of causes: every suspect fitted jointly with the parameters, compared by prediction."""
