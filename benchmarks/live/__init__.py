"""The live stream: one frame inside of a process, and all of it over DDS."""
