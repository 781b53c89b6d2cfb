# Completion of lathe for fish.
function _lathe_complete
    set -l words (commandline -opc)
    set -l command (string replace -r '^~' $HOME $words[1])
    for each in (env _LATHE_COMPLETE=fish_complete COMP_WORDS=(commandline -cp | string collect) \
            COMP_CWORD=(commandline -t | string collect) $command 2>/dev/null)
        set -l answer (string split -m 1 , $each)
        switch $answer[1]
            case dir
                __fish_complete_directories $answer[2]
            case file
                __fish_complete_path $answer[2]
            case plain
                echo $answer[2]
        end
    end
end
complete --no-files --command lathe --arguments '(_lathe_complete)'
