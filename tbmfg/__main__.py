from tbmfg.cli import main

main()
