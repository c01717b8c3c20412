"""Native libraries: loaded quietly, and used without their leaks."""
