"""Refinement of a finished mesh by what photos say of its surface: parallax, reflections and silhouettes in one least-squares system."""
