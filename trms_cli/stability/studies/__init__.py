"""The studies of `trms stability`: one class in one file each, one YAML in configs/study."""
