"""The least-squares solver on jax: residuals, steps, their compilation, and what a solve may change."""
