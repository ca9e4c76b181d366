"""The network of the paper: encoder, PCAA, SPP, LitePAN, heads; its weights files."""
