"""Deployment: export of policies and driving of live rovers."""
