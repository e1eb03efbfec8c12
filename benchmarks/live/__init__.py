"""The live stream: one frame inside a process, and all of it over DDS."""
