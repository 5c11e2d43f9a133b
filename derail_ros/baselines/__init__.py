"""Simpler models that came before, kept beside the main one for comparison."""
