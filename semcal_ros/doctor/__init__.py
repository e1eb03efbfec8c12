"""The checks of `semcal doctor`: observations, and one small check for each."""
