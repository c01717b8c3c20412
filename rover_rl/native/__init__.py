"""Wrappers of native libraries that suppress their import output and avoid their memory leaks."""
