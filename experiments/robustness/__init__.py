"""Monte Carlo of three controllers over rigs from the priors, and a tuned predictive controller."""
