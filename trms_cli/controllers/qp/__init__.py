"""Quadratic programs of the Newton MPC: one solver a file."""
