"""Every feature with every option of it, in a small scene each, under every condition, with the equality that it must keep."""
