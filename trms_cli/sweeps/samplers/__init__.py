"""Samplers: how the values of a sweep are chosen; one file each, configured in configs/sampler."""
