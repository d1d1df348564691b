"""`benchmark threads`: what a second core gains, on an idle machine and on a busy one."""
