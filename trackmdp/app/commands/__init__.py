"""What each command does, called with a checked config and the folder to write to."""
