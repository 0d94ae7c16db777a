"""The study of observers of chapter 7: who is better, and where."""
