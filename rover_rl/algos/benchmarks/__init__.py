"""Benchmarks of others: BARN and JaxNav."""
