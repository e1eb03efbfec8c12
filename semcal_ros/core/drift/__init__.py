"""Specimen drift over time from image registrations: a Kalman filter, and a smoother for recordings."""
