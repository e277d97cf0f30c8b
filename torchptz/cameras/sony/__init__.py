"""Sony SNC, SRG and BRC cameras."""
