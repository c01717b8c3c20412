"""Deployment: exported policies and live rovers."""
