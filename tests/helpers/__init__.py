"""What several tests share: robots, cases, stand-ins for programs and devices. No test is here."""
