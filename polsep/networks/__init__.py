"""The networks: plain modules, the joint network, its engines and its export."""
