"""The ``msg_configs`` files: where a microscope's topics are, what they carry, and in which units."""
