"""Chapter 2: rotors alone, one axis, two axes by Newton and by Lagrange, bench tests."""
