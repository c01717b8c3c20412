"""Videos of policies that drive."""
