"""Sealed rigs for the students of a course, and the marks of what they hand in."""
