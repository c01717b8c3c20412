"""Videos of driving policies."""
