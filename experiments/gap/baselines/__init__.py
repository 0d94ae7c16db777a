"""What a sceptic would compare a diagnosis with: other ways to answer, scored by the same code.

Each is a class with a ``name`` and ``answer(problem) -> Diagnosis``; what a method cannot tell
stays empty. See ``docs/baselines.md`` for what each does and where it is from.
"""
