"""Methods that are not ours run here: in a process that sees neither truths nor other files."""
