"""What `semcal doctor` looks at and what it makes of it: observations, and one small check for each."""
