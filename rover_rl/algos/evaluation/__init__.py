"""Evaluation: episodes, metrics, tables and plots."""
