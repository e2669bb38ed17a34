"""Losses between surfels and a signed distance field, one module per idea, each with a weight in the section [coupling]."""
