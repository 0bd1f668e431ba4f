"""`python -m avp_habitat.doctor`: what is installed, what can run here, what its hosts see, and the fix where not."""
