"""Networks trained on recordings: regressors, losses, training algorithms, structure."""
