"""Render what the robot's camera sees, in plain JAX: lens, scene, rays and the wrapper."""
