"""Chapter 7: output feedback, observers joined with the predictive controller."""
