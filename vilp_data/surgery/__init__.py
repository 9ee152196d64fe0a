"""Datasets changed in place, and changed back: every operation is a list of renames that history keeps."""
