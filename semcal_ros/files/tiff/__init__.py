"""SEM images in the formats of their makers: TIFF with settings in private tags or a text file."""
