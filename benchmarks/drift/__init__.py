"""Registration and drift tracking beside other methods and the Cramer-Rao bound."""
