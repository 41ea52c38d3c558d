"""Take a policy out of JAX: exporters, a simulated JetBot, logs of real drives."""
