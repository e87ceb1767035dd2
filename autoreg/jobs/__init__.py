"""What a command does with a photo: files read, an answer found, files written."""
