"""Movers of the rows of a batch, the other rovers of a group among them, and how rovers meet them."""
