"""Wrong, missed and unproven answers, counted over a million problems by judges that share nothing with the solver."""
