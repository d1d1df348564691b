"""`benchmark stability`: hard cases, sweeps, noise."""
