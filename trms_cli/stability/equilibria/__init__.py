"""All equilibria of a model in a box: isolated with proof, followed as curves, folds included."""
