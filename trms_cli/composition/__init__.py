"""Composes experiments: choices and values, typed or given as a mapping → one checked mapping."""
