"""How well a model foretells a recording: errors, residual tests, spectra, comparison."""
