"""What every node shares: parameters, quality of service, services, orderly shutdown."""
