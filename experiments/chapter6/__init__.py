"""The study of chapter 6: the Newton-type MPC, and what its claim of stability is worth."""
