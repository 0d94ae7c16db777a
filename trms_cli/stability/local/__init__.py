"""Linearised behaviour around operating points: modes, root loci, controllability."""
