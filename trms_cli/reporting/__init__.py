"""Figures and pages: the only room that imports a plotting library."""
