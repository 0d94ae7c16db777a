"""Many runs held against one another: who tracks best, by how much, and how sure that is."""
