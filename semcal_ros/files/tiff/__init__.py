"""SEM images as makers store them: TIFF with settings in private tags or a text file."""
